"""Our frames against path tracing + Open Image Denoise at equal time, and how much both flicker: `make bench-frames`.

reference  many samples per pixel, two halves, kept on disk
motion     reprojection by known motion, flicker (numpy only)
stability  an orbit of close frames
document   JSON and Markdown

The renderers themselves are in :mod:`dnrpipe.studies.frames`.
"""
