"""Where scans come from: devices, the protocols on them, bring-up, and recorded sessions.

Here bytes become scans. What they mean for a skin or an object is not known here.
"""
