"""A model in the browser, in training or trained: layers, cameras, curves."""
