"""Many sessions on one machine or many: each is run once, whatever dies on the way."""
