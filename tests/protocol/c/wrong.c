/* Configurations with one thing wrong, and what hbp_add says of each; the first that it says something else of. */
#include <stdio.h>
#include "hbp.h"
struct sample { uint16_t a, b; uint8_t c; };
static struct hbp_channel channels[HBP_CHANNELS + 1];
static struct hbp_parameter parameters[2];
static float value = 1;
static uint8_t memory[99];
static int16_t samples[256];
static const uint16_t ids[3] = {3, 1, 4};
static uint16_t enter(void *u, uint8_t s, float *d) { return (void)u, (void)s, (void)d, 0; }
static uint16_t setpoint(void *u, uint8_t m, float v, float w, float *d)
{ return (void)u, (void)m, (void)v, (void)w, (void)d, 0; }
static uint8_t outputs_on(void *u) { return (void)u, 0; }
static struct hbp_config c;
static struct hbp_link l;
static struct hbp h;
static void fill(void)
{
    const struct hbp_channel some[3] = {
        {1, HBP_RAW_U16, 0, 0, offsetof(struct sample, a), 1, 0, "x"},
        {2, HBP_RAW_U16, 0, 0, offsetof(struct sample, b), 1, 0, "y"},
        {3, HBP_RAW_U8, 0, 0, offsetof(struct sample, c), 1, 0, "z"},
    };
    const struct hbp_parameter two[2] = {{1, 0, 0, 0, 2, 1, &value, "p"}, {2, 0, 0, 0, 2, 1, &value, "q"}};
    const struct hbp_config whole = {
        .node = 1, .role = HBP_ROLE_DRIVE, .tick_hz = 1000, .pwm_hz = 100, .name = "drive", .channels = channels,
        .n_channels = 3, .sample_bytes = sizeof(struct sample), .parameters = parameters, .n_parameters = 2,
        .enter = enter, .setpoint = setpoint, .outputs_on = outputs_on,
    };
    for (unsigned k = 0; k < 3; k++) channels[k] = some[k];
    for (unsigned k = 0; k < 2; k++) parameters[k] = two[k];
    c = whole;
}
#define WRONG(what, code) \
    fill(); \
    what; \
    if (hbp_add(&l, &h, &c, 1) != (code)) return puts(#what), 1; \
    l.base.first = NULL;
int main(void)
{
    hbp_link_init(&l, 0);
    WRONG(c.node = 0, HBP_WRONG_NODE)
    WRONG(c.role = 0, HBP_WRONG_NODE)
    WRONG(c.pwm_hz = 3, HBP_WRONG_RATE)
    WRONG(c.enter = NULL, HBP_WRONG_FUNCTION)
    WRONG(c.outputs_on = NULL, HBP_WRONG_FUNCTION)
    WRONG(c.name = "", HBP_WRONG_TEXT)
    WRONG(c.serial = "0123456789012345678901234", HBP_WRONG_TEXT)
    WRONG(c.build = "two\nlines", HBP_WRONG_TEXT)
    WRONG(c.n_channels = HBP_CHANNELS + 1, HBP_WRONG_COUNT)
    WRONG(channels[1].name = "a name of 17 char", HBP_WRONG_CHANNEL_NAME | 1)
    WRONG(channels[1].type = 0, HBP_WRONG_CHANNEL_TYPE | 1)
    WRONG(channels[2].scale = 0, HBP_WRONG_CHANNEL_SCALE | 2)
    WRONG(channels[2].type = HBP_RAW_I32, HBP_WRONG_CHANNEL_PLACE | 2)
    WRONG(channels[2].id = 1, HBP_WRONG_CHANNEL_TWICE | 2)
    WRONG(channels[1].name = "x", HBP_WRONG_CHANNEL_TWICE | 1)
    WRONG(parameters[0].name = NULL, HBP_WRONG_PARAMETER_NAME)
    WRONG(parameters[1].initial = 3, HBP_WRONG_PARAMETER_RANGE | 1)
    WRONG(parameters[1].value = NULL, HBP_WRONG_PARAMETER_VALUE | 1)
    WRONG(parameters[1].id = 1, HBP_WRONG_PARAMETER_TWICE | 1)
    WRONG((c.capture = memory, c.capture_bytes = 9), HBP_WRONG_CAPTURE) /* less than five records of one channel */
    WRONG((c.capture = memory, c.capture_bytes = 0x80000000u), HBP_WRONG_CAPTURE)
    WRONG((c.capture = memory, c.capture_bytes = 99, c.fault_channels = ids, c.n_fault_channels = 3), HBP_WRONG_CAPTURE)
    WRONG((c.capture = memory, c.capture_bytes = 14, c.fault_channels = ids, c.n_fault_channels = 2), HBP_WRONG_CAPTURE)
    WRONG((c.waveform = samples, c.waveform_length = 255), HBP_WRONG_WAVEFORM)
    WRONG((c.waveform = samples, c.waveform_length = 256, c.capture = memory, c.capture_bytes = 10), 0)
    WRONG(, 0)
    return 0;
}
