"""The commands, one file each, and the controller of a case in a running loop."""
