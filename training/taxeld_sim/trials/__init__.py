"""Trials: an object is touched again and again, and what a filter makes of each touch.

The world's scans go straight into the daemon's pipeline: without wire, clock and process.
"""
