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
    h.watchdog = HBP_NONE;
    h.state = HBP_STATE_ARMED;
    for (unsigned k = 0; k < 200000; k++) {
        uint64_t n = draw(), left;
        uint32_t d = (uint32_t)draw() | 1u, ms = (uint32_t)draw() & 0xFFFFu, ticks;
        uint16_t decimation = (uint16_t)((uint16_t)draw() | (k & 1u ? 1u : 0x8000u));
        config.tick_hz = (uint32_t)draw() | 1u;
        config.pwm_hz = (uint32_t)draw() & 0x3FFFFFu;
        if (remainder_of(n, d) != n % d) return 1;
        if (n < 1ull << 63 && hbp_rounded_up(n, decimation) != (uint32_t)((n + decimation - 1) / decimation)) return 2;
        if (periods_in(ms, config.tick_hz) != (uint32_t)((uint64_t)ms * config.tick_hz / 1000u)) return 3;
        if (hbp_in_time(&h, ms, decimation) != (uint64_t)ms * config.pwm_hz / (1000ull * decimation)) return 4;
        ticks = watchdog_ticks(&h);
        h.fed = draw() >> 1;
        h.now = h.fed + (k & 1u ? draw() % (ticks + 2ull) : n >> 1);
        left = h.now - h.fed < ticks ? (ticks - (h.now - h.fed)) * 1000u / config.tick_hz : 0;
        if (hbp_watchdog_ms(&h) != (left < 65534u ? left : 65534u)) return 5;
    }
    return 0;
}
