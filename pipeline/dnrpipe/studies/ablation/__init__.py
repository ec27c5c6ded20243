"""`dnrpipe ablate`: variants of the neural renderer on the same scenes, views, references and machine.

rows             the variants, as data
ablate           options in; results.json, tables, plot and pictures out
cell_loop        the resumable loop over all cells (scene, row, seed)
ablation_tables  Markdown from results.json
ablation_plots   a plot, and the pictures side by side
"""
