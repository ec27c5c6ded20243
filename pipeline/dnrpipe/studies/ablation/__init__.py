"""`dnrpipe ablate`: variants of the neural renderer on the same scenes, views, references and machine.

rows     the variants, as data
scenes   a workspace per scene: passes, ray-traced views, references, base images
cells    one (scene, row, seed): train, measure; runs in worker processes
worker_pool     worker processes for cells
run      the resumable loop over all cells
results  results.json: all cells and what made them
tables   Markdown from results.json
plot     a plot and the pictures side by side
"""
