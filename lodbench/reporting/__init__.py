"""Tables, figures, pages and the leaderboard: results as people read them."""
