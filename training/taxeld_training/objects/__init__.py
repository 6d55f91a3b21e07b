"""Objects on skins: what a skin meets of them. Nothing here imports another room of training."""
