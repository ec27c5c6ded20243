"""Fault injection: mutated files, killed processes, full disks; each tool prints what it injected and what survived."""
