"""SEs from policies: search or copy a policy, write it as an SE, and see what the SE teaches."""
