"""What every package knows: settings, the workspace and its files, the ledger, the console. Imports dnrtrain only.

errors         bad input, as one line
settings       models of all settings, presets, layers
workspace      paths of a workspace, its manifest and lock
scene_files    readers of what stages wrote
cameras        where candidate and test views stand
ledger         what every piece of work cost
console        what a person reads, progress bars, ``--json``
event_stream   what a running command tells other programs
units          1%, 10m, 1h30m
"""
