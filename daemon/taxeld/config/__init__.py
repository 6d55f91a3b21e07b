"""The configuration: its tables with their defaults and bounds, and the file they are read from.

The tables are plain dataclasses and reach no file, socket or clock; `file` alone reads one.
"""
