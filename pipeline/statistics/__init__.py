"""What the numbers mean: errors, intervals, floors, success rates.

Nothing here trains, and nothing here draws. Definitions and their sources stand beside each function.
"""
