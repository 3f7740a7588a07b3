"""Files of a data set: shards and journal; verification and repair."""
