"""Results as files of other programs: a corrected MJCF, and what such a file cannot express."""
