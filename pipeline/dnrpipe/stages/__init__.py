"""The pipeline itself: each stage reads files of a workspace and writes files of it.

pipeline      the list of stages; what is stale or done; run one
prepare       scene file -> scene/, cameras/, passes/
select        which views are worth ray-tracing -> selection.json
raytrace      the selected views -> raytraced/train
finetune      step 2 -> checkpoints/step2
evaluate      held-out views -> evaluation/
render        novel views -> renders/
base_images   baked light, and the images that the network corrects -> base/
session       one command's hold on a workspace
"""
