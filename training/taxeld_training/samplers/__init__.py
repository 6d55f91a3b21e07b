"""Samplers, measured: `taxeld-train evaluate` for samplers, and the candidates of a bundle.

Imports all rooms but `filters`, `charts` only where it draws.
"""
