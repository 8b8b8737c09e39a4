"""The computation of batch flights, in processes of their own: the nodes that fly, on images as they are uploaded."""
