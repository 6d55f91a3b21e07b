"""The harness: a simulated skin and robot, the processes around a daemon, and what came of them."""
