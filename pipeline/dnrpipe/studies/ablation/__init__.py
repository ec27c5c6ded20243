"""`dnrpipe ablate`: variants of the neural renderer on the same scenes, views, references and machine.

rows             the variants, as data
ablate           the resumable loop over all cells (scene, row, seed); tables, plot and pictures
ablation_tables  Markdown from results.json
ablation_plots   a plot, and the pictures side by side
"""
