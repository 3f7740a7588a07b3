"""Networks: nn.Modules from a scaled force field (B, N, D) to a scaled displacement field (B, N, D).

Each is built from a scene and its own options, and is float32 throughout.
"""
