"""taxeld: the daemon that turns touches of artificial skin into object poses."""

__version__ = "0.3.0"
