"""Path tracing with Mitsuba 3: the only package that imports mitsuba, and only in worker processes.

tasks                       what the workers are asked, and what they answer
tracer, pass_worker         path-traced views: a number of samples; to a noise level or within a time
light_worker, base_worker   baked light; base images (base_renderer, specular_paths)
surface_maps, pilot         what surfaces are, over the atlas; path depth, and what effects cost
frames                      G-buffers and path tracing in milliseconds, for timing and the live view
engine, plugins             Mitsuba in a process; what Blender has and Mitsuba has not
denoise, noise, statistics  Open Image Denoise; how noisy a picture is; what paired renders tell
variants                    which Mitsuba variant runs here (probed in a subprocess); imports no mitsuba
"""
