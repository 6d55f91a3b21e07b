"""Messages, the pair that joins the loop to the door, and clients of a running daemon.

A peer's bad message is a counter. The loop imports nothing here that needs ZeroMQ.
"""
