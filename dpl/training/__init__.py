"""The LightningModule, its losses, metrics, optimisers and callbacks."""
