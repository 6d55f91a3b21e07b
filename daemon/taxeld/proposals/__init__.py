"""Samplers of poses that explain a touch: analytic, stored and learned; the bundle that holds them.

`choice` is the only module that measures time; the estimator never asks how long a sampler takes.
"""
