"""What the numbers mean: errors, intervals, floors, success rates. Nothing here trains, and nothing here writes a file that
people look at. Definitions and their sources are in docs/ and beside each function.
"""
