"""The core: scans in, planes out. Pure functions of integers; no clock, I/O, threads or logs."""
