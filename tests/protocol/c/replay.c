/* replay.c: a drive that a script talks to: what the vectors say goes in, what it answers comes out.
 *
 * Lines of standard input, numbers and bytes in hexadecimal:
 *     new FEATURES        another drive on another byte link, which has booted
 *     bus FD EXTENDED     another one on a CAN bus
 *     rx BYTES            bytes come in
 *     can ID BYTES        a CAN frame comes in
 *     fault BITS          the drive finds a fault
 * For each it prints one line: damaged frames so far, state, and the bytes that the drive sent (on CAN ID:BYTES of each frame).
 */
#include "drive.h"

#include "../../../protocol/c/hbp_can.h"

static struct hbp_link *link_;
static struct hbp_can *can;
static struct hbp *device;
static struct hbp_config config;
static struct hbp_parameter parameters[4];
static struct hbp_can_bus bus;
static struct app app;
static uint8_t memory[4096];   /* for captures */
static int16_t waveform[256];

static void begin(uint32_t features)
{
    free(link_);
    free(can);
    free(device);
    link_ = NULL;
    can = NULL;
    device = malloc(sizeof *device);
    configure_drive(&config, parameters, &app, 1, features);
    if (features & HBP_FEATURE_CAPTURE) {
        config.capture = memory;
        config.capture_bytes = sizeof memory;
    }
    if (features & HBP_FEATURE_WAVEFORM) {
        config.waveform = waveform;
        config.waveform_length = 256;
    }
    if (features & HBP_FEATURE_MEANINGS) config.meanings = "hall what the sensors say\n";
    config.commit = features & HBP_FEATURE_COMMIT ? app_commit : NULL;
}

static void tell(void)
{
    const struct hbp_can_frame *frame;
    const uint8_t *bytes;
    size_t n;
    printf("%x %x ", (unsigned)(device->link->bad), (unsigned)device->state);
    while (link_ && (n = hbp_tx_peek(link_, &bytes)) > 0) {
        for (size_t k = 0; k < n; k++) printf("%02x", bytes[k]);
        hbp_tx_advance(link_, n);
    }
    while (can && (frame = hbp_can_peek(can)) != NULL) {
        printf(" %x:", (unsigned)frame->id);
        for (size_t k = 0; k < frame->length; k++) printf("%02x", frame->data[k]);
        hbp_can_advance(can);
    }
    printf("\n");
}

/* The bytes of a line from `hex` on, in memory of just their length. */
static uint8_t *bytes_of(const char *hex, size_t *n)
{
    size_t length = strspn(hex, "0123456789abcdef");
    uint8_t *bytes = malloc(length / 2 + 1);
    for (*n = 0; *n < length / 2; ++*n) {
        char two[3] = {hex[2 * *n], hex[2 * *n + 1], 0};
        bytes[*n] = (uint8_t)strtoul(two, NULL, 16);
    }
    return realloc(bytes, *n ? *n : 1);
}

int main(void)
{
    static char line[1 << 16];
    char *rest;
    uint8_t *bytes;
    size_t n;
    while (fgets(line, sizeof line, stdin)) {
        if (!strncmp(line, "new ", 4)) {
            begin((uint32_t)strtoul(line + 4, NULL, 16));
            link_ = malloc(sizeof *link_);
            hbp_link_init(link_, 0.0f);
            REQUIRE(!hbp_add(link_, device, &config, BOOT));
            hbp_poll(link_, 0);
        } else if (!strncmp(line, "bus ", 4)) {
            begin(HBP_FEATURE_EDGES);
            bus.bitrate = 1000000;
            bus.data_bitrate = strtoul(line + 4, &rest, 16) ? 5000000 : 0;
            bus.extended = strtoul(rest, NULL, 16) != 0;
            can = malloc(sizeof *can);
            REQUIRE(!hbp_can_init(can, &bus) && !hbp_can_add(can, device, &config, BOOT));
            hbp_can_poll(can, 0);
        } else if (!strncmp(line, "rx ", 3)) {
            bytes = bytes_of(line + 3, &n);
            hbp_rx(link_, 0, bytes, n);
            free(bytes);
        } else if (!strncmp(line, "can ", 4)) {
            uint32_t id = (uint32_t)strtoul(line + 4, &rest, 16);
            bytes = bytes_of(rest + 1, &n);
            hbp_can_rx(can, 0, id, bytes, n);
            free(bytes);
        } else if (!strncmp(line, "fault ", 6)) {
            hbp_fault(device, (uint32_t)strtoul(line + 6, NULL, 16));
        } else {
            return 2;
        }
        tell();
    }
    begin(0);
    free(device);
    return 0;
}
