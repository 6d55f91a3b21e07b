"""`taxeld calibrate`: a mounted skin is measured by presses of a known object.

It uses the daemon's own source, decoder and pipeline, and no other room of the harness.
"""
