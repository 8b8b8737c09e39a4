"""`terrafix init`, `terrafix config`: the files of a vehicle, written, checked and described for editors."""
