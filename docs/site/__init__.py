"""The documentation site: pages of the repository, a reference made from the code, a strict build."""
