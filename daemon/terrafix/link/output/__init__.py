"""What is sent, in which protocol and when."""
