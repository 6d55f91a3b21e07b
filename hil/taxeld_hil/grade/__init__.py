"""The grade of a session: estimates against the truth, flags in time, counters against the ledger.

It uses what the daemon publishes, and nothing of its inside.
"""
