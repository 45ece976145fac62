"""Dagster's view of the work: assets, checks, jobs, schedules, sensors. The work itself is in `pipeline/`.

Nothing here imports torch, mlflow, rerun, pandas, pyarrow or scipy while definitions load: assets import what they use in
their bodies, so that the UI and the code server start fast.
"""
