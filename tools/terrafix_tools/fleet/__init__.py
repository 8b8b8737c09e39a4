"""`terrafix fleet`: many flight records as tables, with queries and a page of trends."""
