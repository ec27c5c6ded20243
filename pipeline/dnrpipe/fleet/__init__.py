"""Many scenes, unattended: `dnrpipe batch`."""
