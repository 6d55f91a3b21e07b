"""The simulated world: object, soft skin, its electronics, and the robot's path.

There is no wire, no fault and no daemon in it.
"""
