"""LeRobot data sets: reading (v2.0, v2.1, v3.0), writing (v3.0), fetching from the Hub, and what their columns mean.

    read.py     a source or a folder → Demonstrations        layout.py   what a folder says about itself
    frames.py   parquet → arrays                             cameras.py  the video streams it declares
    kinds.py    is an action a position, a velocity, …       saved.py    Demonstrations on disk, their content hash
    write.py    arrays → a v3.0 folder                       stats.py    the statistics LeRobot keeps beside the data
    hub.py      download at a pinned commit                  quality.py  kinds, circular columns, warnings, the summary
    files.py    files of an untrusted folder                 units.py    column names and units
    pictures.py frames of its videos, when they are asked for

A data set is untrusted input: its paths stay inside its folder, sizes are checked before memory is taken, and nothing
is unpickled. Nothing here splits, scales or trains.
"""
