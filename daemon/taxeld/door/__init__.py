"""The door: a process of its own that owns every peer, by ZeroMQ.

`taxeld run` starts and watches it (`taxeld.service.doorkeeper`). What a peer does to it, or to
ZeroMQ, ends this process at the worst, and never the loop.
"""
