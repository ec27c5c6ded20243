"""Our frames against path tracing + Open Image Denoise at equal time, and how much both flicker: `make bench-frames`.

bench_workspace  one workspace through the benchmark
reference        many samples per pixel, two halves, kept on disk
standing         one renderer against the baselines
motion           reprojection by known motion, flicker (numpy only)
moving           an orbit and a walk: ours that remember, and rivals that gather their samples
moving_tables    its tables over all scenes
equal_time       what N frames cost, everything before the first one included
document         JSON and Markdown

The renderers themselves are in `dnrpipe.studies.frames`.
"""
