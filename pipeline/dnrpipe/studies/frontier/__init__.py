"""`dnrpipe frontier`: what accuracy costs in time, measured: our choices, baselines, and the best of all.

measure_frontier     the points as rows of an ablation: views x samples x steps, and other ways to train; baselines
baseline_worker      path tracing of the test views with and without a denoiser; Cycles, by its own reference
point_costs          what each point cost before its first frame, and each frame; break-even
frontier_plots       metrics against total seconds
frontier_report      the table and the sentences below it
"""
