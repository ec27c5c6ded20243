"""`dnrpipe bench-select`: policies of view selection on the same scenes, candidates, budgets, model and time.

pools          sets of candidates: a workspace per scene and pool
rigs           cameras of the pools that are no spheres
policies       what competes, as data
bench_select   the resumable loop: selections, ray tracing of the chosen views, cells; report and plots
rule_worker    one selection by a rule, in a worker process
active/        baselines from the literature that train renderers of their own
figures        numbers of a table from results.json, paired differences and their confidence
bench_tables   the report in Markdown
bench_plots    curves against views and against seconds
"""
