"""Predictions that were made elsewhere, with any code, and become a row of the same table.

What belongs here: the anchors that others fill in (`anchors`), reading what they send as untrusted input (`reading`), whether it
is aligned with what was recorded (`checks`), what its policy was trained on (`training`), scoring it (`scoring`) and comparing
it on the episodes that both hold out (`pairing`). What does not: asking a policy (`lerobot_bridge`), the table, Dagster.

A file of predictions has one row an anchor (× seed × sample): `episode_index` and `frame_index` as recorded, `action` K × A in the
data set's units, and, where there are several, `seed`, `sample` and `fold`. docs/scoring.md describes it for people.
"""
