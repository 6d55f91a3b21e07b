"""Sources of scans: devices, the protocols on them, bring-up, and recorded sessions.

Here bytes become scans. Their meaning for a skin or an object is not known here.
"""
