"""Map package reader: a library without dependencies on the nodes, used by the anchor and by the tools."""
