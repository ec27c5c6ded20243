"""`dnrpipe bench-select`: policies of view selection on the same scenes, candidates, budgets, model and time.

pools      sets of candidates: a workspace per scene and pool
rigs       cameras of the pools that are no spheres
policies   what competes, as data
choosing   one selection, in a worker process
active/    rivals from the literature that train renderers of their own
run        the resumable loop: selections, ray tracing of what was chosen, cells (those of `dnrpipe ablate`)
results    results.json: all cells and what made them
intervals  paired differences and their confidence
figures    numbers of a table from results.json
tables     the report in Markdown
plot       curves against views and against seconds
command    options in, files out
"""
