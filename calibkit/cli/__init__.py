"""The command line: arguments in, stage called, outcome printed, exit code."""
