"""From scans and sensor poses to estimates, in one pure object; and whether an estimate is valid.

The daemon, the replay and the harness run this same code. Its clock, if any, is given to it.
"""
