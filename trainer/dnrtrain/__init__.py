"""dnrtrain: the deferred neural renderer and its view selector (torch; no Blender, no Mitsuba).

    contract, exr, dataset         what the trainer eats: views, channels, units, EXR files -> tensors
    textures, aggregator, renderer neural texture pyramids -> spatial neural texture -> RGB
    model                          aggregator + renderer = the DNR
    losses, perceptual, metrics    the six losses of step 2; PSNR, SSIM, LPIPS
    selector                       the Q-learning view selector and its rivals, one protocol
    schedule                       step 1 and step 2; yields events, never prints
    checkpoint                     safetensors + JSON

Submodules are imported where they are used: ``import dnrtrain`` itself costs nothing.
"""
