"""A door: a process of its own that owns peers, by ZeroMQ. Those over TCP have one to themselves.

`taxeld run` starts and watches it (`taxeld.service.doorkeeper`). What a peer does to it, or to
ZeroMQ, ends this process at the worst, and never the loop.
"""
