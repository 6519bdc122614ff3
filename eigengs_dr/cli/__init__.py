"""The command line: what a command parses, calls and prints."""
