"""The commands, one file each: check, identify, discover and study, and following a machine live."""
