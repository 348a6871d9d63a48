/* hbp_can.h: HBP on a CAN or CAN FD bus (chapter 16 of SPEC). Read hbp.h first: tables, configuration, samples, edges, faults and who
 * may call what are the same. In place of bytes:
 *
 *     static struct hbp_can can;
 *     static const struct hbp_can_bus bus = {.bitrate = 1000000};           // data_bitrate 0: classic CAN
 *
 *     hbp_can_init(&can, &bus);
 *     hbp_can_add(&can, &drive, &config, random_number());                  // one device to a controller
 *     for (;;) {
 *         while (mailbox_receive(&id, data, &n)) hbp_can_rx(&can, ticks(), id, data, n);
 *         hbp_can_poll(&can, ticks());
 *         const struct hbp_can_frame *frame;                                // or from the transmit interrupt
 *         while (mailbox_free() && (frame = hbp_can_peek(&can)) != NULL) {
 *             mailbox_send(frame->id, frame->data, frame->length);          // FD: with the bit-rate switch
 *             hbp_can_advance(&can);
 *         }
 *     }
 *
 * Filters of the controller, by bits 10 to 8, 7 to 4 and 3 to 0 of an identifier: class 0 to the own node and to node 0; class 1 to the own
 * node; class 2 to the own node and to node 0. Frames with the same identifier must leave in the order of hbp_can_peek. One with `streamed`
 * that has stood in a mailbox for more than half a second must be taken back: hbp_can_gave_up.
 */
#ifndef HBP_CAN_H
#define HBP_CAN_H

#include "hbp.h"

#ifdef __cplusplus
extern "C" {
#endif

#ifndef HBP_CAN_BYTES
#define HBP_CAN_BYTES 8 /* data of a frame: 8, or 64 for CAN FD */
#endif
#ifndef HBP_CAN_MESSAGES
#define HBP_CAN_MESSAGES 32 /* frames of messages that can wait, a power of two, 32 at least: replies are as long as fits beside a heartbeat */
#endif
#ifndef HBP_CAN_STREAMED
#define HBP_CAN_STREAMED 16 /* frames of streams that can wait, a power of two, 16 at least */
#endif
#ifndef HBP_CAN_TRANSFERS
#define HBP_CAN_TRANSFERS 3 /* transfers that come in at the same time, two more than hosts: ALIVE, SETPOINT, each host's requests */
#endif

#define HBP_CAN_EXTENDED 0x80000000u /* bit of `id`: 29 bits */

struct hbp_can_bus {
    uint32_t bitrate, data_bitrate; /* data_bitrate 0: classic */
    uint8_t extended;               /* 1: identifiers of 29 bits */
};

struct hbp_can_frame {
    uint32_t id; /* with HBP_CAN_EXTENDED */
    uint32_t stamp;
    uint8_t length, streamed;
    uint8_t data[HBP_CAN_BYTES];
};

struct hbp_transfer { /* coming in */
    uint32_t used;
    uint16_t key, n;
    uint8_t expected, last_length;
    uint8_t last[HBP_CAN_BYTES];
    uint8_t buffer[2 + 6 + HBP_RX_MAX + 4 + HBP_CAN_BYTES];
};

struct hbp_can {
    struct hbp_link_base base;
    const struct hbp_can_bus *bus;
    uint8_t host, slots[2];           /* number of the host that is being answered; where the circles of slots go on */
    uint8_t shift;
    uint8_t from;                     /* the reader's: the queue of the frame that it was shown */
    volatile uint16_t head[2], tail[2]; /* of both queues */
    volatile uint32_t now, most_age;  /* ticks, shifted */
    uint32_t clock, foreign, orphans, duplicates;
    uint8_t next[16 + 3];             /* transfer ids */
    uint8_t made[8 + HBP_TX_MAX + 4]; /* a message, before it is cut into frames */
    struct hbp_transfer transfers[HBP_CAN_TRANSFERS];
    struct hbp_can_frame messages[HBP_CAN_MESSAGES], streamed[HBP_CAN_STREAMED];
};

/* 0, HBP_WRONG_BUS (one that was not compiled for: HBP_CAN_BYTES; or without a bit rate), or HBP_WRONG_OPTIONS. */
uint32_t hbp_can_init_sized(struct hbp_can *can, const struct hbp_can_bus *bus, size_t size);

static inline uint32_t hbp_can_init(struct hbp_can *can, const struct hbp_can_bus *bus)
{
    return hbp_can_init_sized(can, bus, sizeof *can);
}

/* The one device on this controller; see hbp_add. */
uint32_t hbp_can_add_sized(struct hbp_can *can, struct hbp *device, const struct hbp_config *config, uint32_t boot_id, size_t size);

static inline uint32_t hbp_can_add(struct hbp_can *can, struct hbp *device, const struct hbp_config *config, uint32_t boot_id)
{
    return hbp_can_add_sized(can, device, config, boot_id, sizeof *can + sizeof *device);
}

/* Take a data frame that has come, whosever. `id` with HBP_CAN_EXTENDED if it has 29 bits. */
void hbp_can_rx(struct hbp_can *can, uint64_t now, uint32_t id, const uint8_t *data, size_t n);

/* See hbp_poll. */
void hbp_can_poll(struct hbp_can *can, uint64_t now);

/* The frame to be sent next, null if there is none; then say that it has gone into a mailbox. */
const struct hbp_can_frame *hbp_can_peek(struct hbp_can *can);
void hbp_can_advance(struct hbp_can *can);

/* A stream frame was taken back from a mailbox, where it had stood for more than half a second. */
void hbp_can_gave_up(struct hbp_can *can);

#ifdef __cplusplus
}
#endif
#endif
