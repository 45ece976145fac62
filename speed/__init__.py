"""Measurements of speed, each as a ratio against a plain version in the same run: absolute times drift with the machine.

`python -m speed` runs all of them on the embedded data set and prints one line each. Nothing here is a test.
"""
