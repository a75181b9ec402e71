"""SEs from policies: search or copy one, write it down as an SE, and see what the SE teaches."""
