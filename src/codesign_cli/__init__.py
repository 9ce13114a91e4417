"""The `codesign` command: parses, calls the libraries, prints."""
