"""`dnrpipe frontier`: what accuracy costs in time, measured: our choices, their rivals, and the best of them.

run        the sweep as cells of an ablation: budgets x samples x epochs, random views, all views, the paper's model
rivals     path tracing of the test views with and without a denoiser, in a process of its own
account    what each point cost before its first frame, and each frame; break-even
command    what the command does; results.json, results.csv, plots
plot       metrics against total seconds
words      the table and the sentences below it
"""
