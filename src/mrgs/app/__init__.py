"""The command line: its options, its handlers and what it prints."""
