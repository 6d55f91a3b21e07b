"""What samplers and filters are measured against: the exact posterior, a grid filter, rivals.

The metrics stand here too. No sampler that ships is used to measure itself.
"""
