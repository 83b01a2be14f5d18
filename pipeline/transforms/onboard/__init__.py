"""What an instrumented vehicle knows of the vehicles around it: messages, LiDAR and camera joined to tracks."""
