"""Where to touch next: approaches whose outcome would tell most of what is still open.

Pure like the estimator: no clock, no socket, no file.
"""
