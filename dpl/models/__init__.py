"""Networks: nn.Modules from scaled forces (B, N, D) to scaled displacements (B, N, D).

Each is built from a scene and its own options, and is float32 throughout.
"""
