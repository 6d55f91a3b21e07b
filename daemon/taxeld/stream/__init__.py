"""What goes to other processes and comes from them: messages, sockets (the loop's
own, and ZeroMQ's), control, keys.

Nothing here estimates; a peer's bad message is a counter.
"""
