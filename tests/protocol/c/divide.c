/* hbp.c's own divisions beside the compiler's: 0 if all are right. */
#include "hbp.c"
static uint64_t state = 1;
static uint64_t draw(void)
{
    state = state * 6364136223846793005u + 1442695040888963407u;
    return (state >> 33 | state << 31) >> (state >> 58);
}
int main(void)
{
    struct hbp_config config = {0};
    struct hbp h = {0};
    h.config = &config;
    for (unsigned k = 0; k < 200000; k++) {
        uint64_t n = draw();
        uint32_t d = (uint32_t)draw() | 1u, rest, quotient = divide(n, d, &rest), ms = (uint32_t)draw() & 0xFFFFu;
        uint16_t decimation = (uint16_t)((uint16_t)draw() | (k & 1u ? 1u : 0x8000u));
        config.tick_hz = (uint32_t)draw();
        if (quotient != (uint32_t)(n / d) || rest != n % d) return 1;
        if (n < 1ull << 63 && hbp_rounded_up(n, decimation) != (uint32_t)((n + decimation - 1) / decimation)) return 2;
        if (ticks_of(&h, ms) != (uint32_t)((uint64_t)ms * config.tick_hz / 1000u)) return 3;
    }
    return 0;
}
