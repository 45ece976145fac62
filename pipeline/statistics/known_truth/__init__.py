"""The known-truth suite: data whose answer is known, and how far the estimators and intervals of this project are off.

generators  demonstrations whose floors are known exactly
studies     one estimator, one generator, one block of repeats: a small record
shards      all studies of a run, computed in processes, kept on disk, resumable
goals       what must hold, and whether it does

Nothing here is used by a benchmark; nothing here draws or prints.
"""
