"""The core: scans in, planes out. Pure functions of integers; no clock, no I/O, no threads, no logs."""
