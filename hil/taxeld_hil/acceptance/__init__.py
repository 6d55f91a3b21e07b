"""`taxeld-hil accept`: a real skin is measured without an object, and checked part by part.

It uses the daemon's own source and decoder, and no other room of the harness.
"""
