"""Is this data any good? Detectors that need no training, and what to do about what they find.

    survey.py     what several detectors need, worked out once: ranges, dead columns, runs
    finding.py    what a detector yields, the list of checks, and putting findings in order
    clock.py      jitter, gaps, another rate than fps             tracking.py  does the arm follow its commands, how late
    motion.py     idle starts and ends, jumps                     channels.py  saturated, dead and frozen columns
    alike.py      the same recording twice                        outliers.py  short, long, odd start, odd path
    videos.py     frames of the video files against meta/         labels.py    tasks, units
    look.py       all of them, the episodes to look at, the episodes worth leaving out

A detector is a function of a survey (or of demonstrations and semantics) that yields findings. It changes nothing, and
nothing here decides what a benchmark uses: `exclude` in the configuration does. How often detectors are wrong is measured by
`python -m speed.inspect_faults`.
"""
