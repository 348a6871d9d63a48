/* Faults that are raised any number of times between two polls: 1 if one is lost. */
#include "hbp.h"
static struct hbp h;
int main(void)
{
    for (unsigned n = 1; n < 1100; n++) {
        h.raised = h.seen = n << 24 | 5u; /* the same faults, seen before */
        for (unsigned k = 0; k < n; k++) hbp_raise(&h, k % 2 ? 4u : 1u);
        if (h.raised == h.seen || (h.raised & 0xFFFFFFu) != (n > 1 ? 5u : 1u)) return 1;
    }
    return 0;
}
