"""Files of a data set: shards, manifests, pending loads, journal; verification and repair."""
