"""The front door: the command line (`demobench.cli`)."""
