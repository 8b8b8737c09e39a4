"""Limits of the processes that compute flights."""

# Of the address space of one flight: a decoder that asks for more fails [spec: five times what is used]
MEMORY_BYTES = 6 * 2**30
