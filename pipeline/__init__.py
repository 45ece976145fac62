"""The work itself: reading demonstrations, splitting, training, scoring, floors, roll-outs and the files people look at.

Nothing here knows Dagster. Imports go one way; the order is held by import-linter (see pyproject.toml).
"""
