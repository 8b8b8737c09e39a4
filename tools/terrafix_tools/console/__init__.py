"""The console: flights over HTTP and events, for a page, a program or an operator (docs/console.md)."""
