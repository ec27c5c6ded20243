"""dnrpipe: from a .blend file to a fast neural renderer, ray-tracing only the views that matter.

    scene.blend -> prepare            census, Mitsuba bundle, cameras, raster passes and G-buffers   (bpy)
                -> select             coarse deferred neural renderer + view selector, step 1        (torch)
                -> raytrace-selected  path tracing of the selected views only                        (Mitsuba)
                -> finetune           six losses on the selected views, step 2                       (torch)
                -> evaluate           held-out test views, ray-traced on demand
                -> render             novel views with the neural renderer
                -> report             what accuracy cost in time, as one HTML file

Every stage is a function of files in a workspace (``scene.dnr/``); see `dnrpipe.core.workspace`.
Nothing heavy is imported here.
"""

__version__ = "0.1.0"
