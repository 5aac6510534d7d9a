"""ClothFit, the learned baseline: pose-conditioned garment deformation, one small network for all vertices, no cloud.

``binding`` ties the garment to the body, ``motion`` and ``features`` make the network's inputs, ``network`` is it (NumPy),
``library``, ``examples``, ``training`` and ``weights`` teach it (PyTorch), ``method`` uses it.
"""
