"""Wire formats of capacitive robot skin: pure bytes → values, no I/O, no clock."""
