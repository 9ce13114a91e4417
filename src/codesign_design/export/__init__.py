"""Finger pairs as files for printers, robots and simulators; every file states its unit."""
