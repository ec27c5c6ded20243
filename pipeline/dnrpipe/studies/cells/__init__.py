"""What studies share: train and measure one (scene, variant, seed).

cell          the worker: one cell
worker_pool   how many workers, on how many threads
scenes        a study's workspaces: passes, ray-traced views, references, base images
measure       pictures -> metrics and milliseconds
provenance    command, commit, date, machine, versions of a results file
markdown      helpers of the studies' tables
"""
