"""Laws with fibres, a leaf: no other file of the mechanics needs them but active stress."""
