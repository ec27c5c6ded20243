"""How faithful the conversion is: one-feature scenes, each rendered by Cycles and by our bundle (``make fidelity``).

catalogue     the list of scenes: a title, a group, a builder, and other exporters' formulas to compare with
studio        what builders share: camera, sky, floor, subjects, materials (bpy)
scenes_*      the builders, by family (bpy)
reference     worker: builds a scene and renders it with Cycles (bpy)
ours          product code: conversion, then ray tracing, each in its own process
formulas      the same bundle with another exporter's formula in one place (XML edit)
measure       pictures -> numbers: relative RMSE, PSNR, FLIP, energy ratio, noise floor, verdict
sheet, document   contact sheets and docs/fidelity.md
gallery       the example scenes side by side, docs/scenes.md (``make scenes``)
"""
