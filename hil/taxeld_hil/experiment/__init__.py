"""`taxeld-hil physics`: the estimator's model compared with a simulated soft skin.

What is measured here is written as JSON and as a picture; nothing is graded.
"""
