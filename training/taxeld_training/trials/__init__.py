"""Questions and their answers: trials of the harness, their figures, tables, charts and pages.

Imports all other rooms, `charts` only where it draws.
"""
