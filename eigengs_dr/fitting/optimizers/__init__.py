"""Variables, optimisers and schedules of gradient descent."""
