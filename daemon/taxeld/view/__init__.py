"""What people look at: the streams, live or from a session, as a terminal's page, a scene in three
dimensions and a file for other tools.

Processes of their own that subscribe like anybody; nothing of the daemon imports this room.
"""
