"""The version, alone in a file so that packaging and `--version` need no import of anything else."""

__version__ = "0.1.0"
