"""From scans and sensor poses to estimates, in one pure object; what makes an estimate valid.

The daemon, the replay and the harness run this same code. It is handed its clock, if it has one.
"""
