"""Kinds of scene. Each module has ``build(stage)``, which fills the empty scene and says from where to look."""
