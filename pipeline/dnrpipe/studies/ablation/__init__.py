"""`dnrpipe ablate`: variants of the neural renderer on the same scenes, views, references and machine.

rows              the variants, as data
ablate            options in, files out
cell_loop         the resumable loop over all cells (scene, row, seed)
ablation_results  results.json: all cells and what made them
ablation_tables   Markdown from results.json
ablation_plots    a plot, and the pictures side by side
"""
