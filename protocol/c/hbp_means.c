/* hbp_means.c: means of channels over the periods from record to record, for streams of the event MEAN (11.51 of SPEC). See hbp.h.
 *
 * hbp_tick adds up in each period, and makes a record of the sums in the last one. Whole numbers are added as they are, divided once and
 * rounded once. An f32 is added up as a double, which takes a core without them many instructions.
 */
#include "hbp_way.h"

#include <string.h>

#if HBP_MEANS

#define TWO_PI 6.283185307179586
#define TURNS 1e9                    /* an f32 that is so many from zero has lost its angle */
#define PART 2.3283064365386963e-10f /* 2^-32 */

static int is_real(const struct hbp_channel *channel)
{
    return channel->type == HBP_RAW_F32;
}

static int wraps(const struct hbp_channel *channel)
{
    return (channel->flags & HBP_FLAG_WRAPS) != 0;
}

/* ---- whole numbers ----------------------------------------------------------------------------------------------------------- */

static int64_t whole_of(const struct hbp_channel *channel, const uint8_t *sample)
{
    const uint8_t *from = sample + channel->at;
    uint16_t half;
    uint32_t word;
    switch (channel->type) {
    case HBP_RAW_U8: return *from;
    case HBP_RAW_I8: return (int8_t)*from;
    case HBP_RAW_U16:
    case HBP_RAW_I16:
        memcpy(&half, from, sizeof half);
        return channel->type == HBP_RAW_I16 ? (int16_t)half : half;
    default:
        memcpy(&word, from, sizeof word);
        return channel->type == HBP_RAW_I32 ? (int64_t)(int32_t)word : (int64_t)word;
    }
}

static int64_t turn_of(const struct hbp_channel *channel)
{
    return (int64_t)1 << 8u * hbp_widths[channel->type];
}

/* The least value of the type. */
static int64_t least_of(const struct hbp_channel *channel)
{
    int has_sign = channel->type == HBP_RAW_I8 || channel->type == HBP_RAW_I16 || channel->type == HBP_RAW_I32;
    return has_sign ? -turn_of(channel) / 2 : 0;
}

/* A value that is at most a turn away from the turn that begins with `least`, taken into it. */
static int64_t into_turn(int64_t value, int64_t least, int64_t turn)
{
    if (value < least) return value + turn;
    return value < least + turn ? value : value - turn;
}

static void add_whole(struct hbp_mean *mean, const struct hbp_channel *channel, int64_t value, int is_first)
{
    int64_t turn = turn_of(channel);
    if (is_first) {
        mean->first.whole = value;
        mean->total.whole = 0;
    }
    mean->total.whole += wraps(channel) ? into_turn(value - mean->first.whole, -turn / 2, turn) : value;
}

/* The f32 that is nearest to total / n: |total| < 2^48. */
static float quotient(int64_t total, uint16_t n)
{
    uint64_t size = (uint64_t)(total < 0 ? -total : total);
    uint32_t whole = hbp_rounded_up(size + 1u, n) - 1u, rest = (uint32_t)(size - (uint64_t)whole * n), fraction = 0;
    float nearest = (float)rest / (float)n;
    if (whole) { /* with 32 binary digits behind the point, the last of which stands for all that follow */
        for (int half = 0; half < 2; half++) {
            rest <<= 16;
            fraction = fraction << 16 | rest / n;
            rest %= n;
        }
        nearest = (float)((uint64_t)whole << 32 | fraction | (rest != 0)) * PART;
    }
    return total < 0 ? -nearest : nearest;
}

static float whole_mean(const struct hbp_mean *mean, const struct hbp_channel *channel, uint16_t n)
{
    int64_t turn = turn_of(channel), least = least_of(channel);
    float nearest;
    if (!wraps(channel)) return quotient(mean->total.whole, n);
    nearest = quotient(into_turn(mean->first.whole * n + mean->total.whole, least * n, turn * n), n);
    return nearest < (float)(least + turn) ? nearest : (float)least; /* it may have been rounded up to a turn */
}

/* ---- real ones --------------------------------------------------------------------------------------------------------------- */

static double real_of(const struct hbp_channel *channel, const uint8_t *sample)
{
    float value;
    memcpy(&value, sample + channel->at, sizeof value);
    return (double)value;
}

/* An angle, taken into the turn around zero. */
static double around_zero(double angle, double turn)
{
    double turns, whole;
    if (angle >= turn / -2.0 && angle < turn / 2.0) return angle;
    turns = angle / turn + 0.5;
    if (!(turns > -TURNS && turns < TURNS)) return angle - angle;
    whole = (double)(int32_t)turns;
    if (whole > turns) whole -= 1.0;
    return angle - whole * turn;
}

static void add_real(struct hbp_mean *mean, double value, int is_first)
{
    if (is_first) {
        mean->first.real = value;
        mean->total.real = 0.0;
    }
    mean->total.real += mean->turn > 0.0 ? around_zero(value - mean->first.real, mean->turn) : value;
}

static float real_mean(const struct hbp_mean *mean, uint16_t n)
{
    double value = mean->total.real / n;
    float nearest;
    if (!(mean->turn > 0.0)) return (float)value;
    nearest = (float)around_zero(mean->first.real + value, mean->turn);
    return nearest >= (float)(mean->turn / 2.0) ? nearest - (float)mean->turn : nearest;
}

/* ---- streams ----------------------------------------------------------------------------------------------------------------- */

void hbp_means_prepare(const struct hbp *h, struct hbp_stream *s)
{
    for (uint32_t k = 0; k < s->channels; k++) {
        const struct hbp_channel *channel = &h->config->channels[s->take[k]];
        double scale = (double)(channel->scale < 0.0f ? -channel->scale : channel->scale);
        s->means[k].turn = is_real(channel) && wraps(channel) ? TWO_PI / scale : 0.0;
    }
}

void hbp_means_add(const struct hbp *h, struct hbp_stream *s, const uint8_t *sample, uint32_t left)
{
    int is_first = left + 1u == s->decimation;
    if (left >= s->decimation) return; /* the first record's periods have not begun */
    for (uint32_t k = 0; k < s->channels; k++) {
        const struct hbp_channel *channel = &h->config->channels[s->take[k]];
        if (channel->unit == HBP_UNIT_NONE) continue; /* the record has its last value */
        if (is_real(channel)) add_real(&s->means[k], real_of(channel, sample), is_first);
        else add_whole(&s->means[k], channel, whole_of(channel, sample), is_first);
    }
}

void hbp_means_put(const struct hbp *h, const struct hbp_stream *s, const uint8_t *sample, uint8_t *to)
{
    for (uint32_t k = 0; k < s->channels; k++) {
        const struct hbp_channel *channel = &h->config->channels[s->take[k]];
        const struct hbp_mean *mean = &s->means[k];
        uint32_t bits;
        float value;
        if (channel->unit == HBP_UNIT_NONE) value = is_real(channel) ? (float)real_of(channel, sample) : (float)whole_of(channel, sample);
        else value = is_real(channel) ? real_mean(mean, s->decimation) : whole_mean(mean, channel, s->decimation);
        memcpy(&bits, &value, sizeof bits);
        to = hbp_put32(to, bits);
    }
}

#else

typedef int hbp_means_are_off; /* a file needs something in it */

#endif
