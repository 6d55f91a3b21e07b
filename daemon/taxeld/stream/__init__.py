"""What goes to other processes and comes from them: messages, ZeroMQ sockets, control, keys.

Nothing here estimates; a peer's bad message is a counter.
"""
