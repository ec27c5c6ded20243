"""What studies share: train and measure one (scene, variant, seed).

cell          the worker: one cell
study         a study's run: its workers, tasks and results
request       what a command line asks for: settings, and names
tasks         what workers are asked, and what their files hold
scenes        a study's workspaces: passes, ray-traced views, references, base images
measure       pictures -> metrics and milliseconds
results       command, commit, date, machine, versions of a results file; Markdown helpers of tables
"""
