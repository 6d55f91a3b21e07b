"""`python -m taxeld.door`: as `taxeld run` starts it."""

from taxeld.door.process import main

main()
