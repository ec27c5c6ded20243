"""What studies share: train and measure one (scene, variant, seed)."""
