"""What the commands do, one file a command; `demobench.cli` holds their arguments, `demobench.progress` the bars."""
