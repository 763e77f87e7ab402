"""The command line: arguments of each command, and the call of its function in Python; one a file."""
