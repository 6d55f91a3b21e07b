"""Samplers: the candidates of a bundle, measured, and the proposals of the experiments.

Imports all rooms but `filters` and `charts`.
"""
