"""What people look at: a daemon's streams or a session in three dimensions, and its advice.

Processes of their own that subscribe like anybody; nothing of the daemon imports this room.
"""
