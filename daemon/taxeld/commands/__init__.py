"""The commands beside `taxeld run`, a module each; `cli` has their arguments."""
