"""From scans and sensor poses to estimates, in one pure object; whether an estimate is valid; and
whether touches agree with the skin's calibration.

The daemon, the replay and the harness run this same code. Its clock, if any, is given to it.
"""
