"""How good can a policy trained on these demonstrations get, is yours there yet, and would more demonstrations help?

From Python: `read`, `split`, `windows`, `floor`, `predict`, `score`, `compare` (`docs/python.md`). From the command line:
`demobench --help`.
"""

from demobench.api import Dataset, Scored, compare, floor, predict, read, score, split, windows

__all__ = ["Dataset", "Scored", "compare", "floor", "predict", "read", "score", "split", "windows"]
